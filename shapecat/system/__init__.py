"""Between the work and the machine: files that appear complete, signals that ask to stop."""
