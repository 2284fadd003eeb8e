"""Commands of the command line, one file each: options in, files out."""
