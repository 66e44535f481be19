"""The machine: devices, processes, clusters and signals."""
