"""One function per command, from input files to output files."""
