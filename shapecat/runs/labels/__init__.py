"""The labels that a person gives the tracks of a run: read, interpreted, applied, transferred."""
