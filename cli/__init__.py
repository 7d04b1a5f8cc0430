"""The command line: one thin command a file over the library."""
