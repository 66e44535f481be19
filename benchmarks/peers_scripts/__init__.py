"""What `benchmarks.peers` compares, and one script for each kind of work, run by the Python of whom it measures."""
