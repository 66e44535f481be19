"""One run: its schedule, loop, session, checkpoints and progress."""
