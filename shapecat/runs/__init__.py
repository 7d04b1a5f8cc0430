"""What a run is: its identity, its folder, its tables, and the labels a person corrected."""
