"""Environments of other libraries that are stepped in Python on the host, as callbacks of the compiled program."""
