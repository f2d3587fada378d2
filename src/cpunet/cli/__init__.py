"""The command line: arguments in, a job, messages out."""
