"""Many settings in few programs."""
