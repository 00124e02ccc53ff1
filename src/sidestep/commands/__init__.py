"""What the command line does, from files to files: one module a command, each of them a function that can be called."""
