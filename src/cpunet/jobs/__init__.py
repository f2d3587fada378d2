"""One function per command: files in, files out; by what is done with them."""
