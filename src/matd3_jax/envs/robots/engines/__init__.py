"""What steps a robot: C MuJoCo on the host, or MJX in the compiled program."""
