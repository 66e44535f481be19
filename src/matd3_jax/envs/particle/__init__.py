"""The particle tasks of MADDPG and MATD3: `world` is the physics, `task` what all share, then one file a task."""
