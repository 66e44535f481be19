"""Run directories: what is written, read back and summarized."""
