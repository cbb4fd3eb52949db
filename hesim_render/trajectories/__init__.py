"""Trajectories in files of other programs."""
