"""Paths whose rays have times of their own, and matt surfaces in closed form."""
