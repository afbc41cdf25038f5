"""What the algorithms share: environments in lockstep, trajectories, buffers, networks."""
