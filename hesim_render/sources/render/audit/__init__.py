"""What a run is worth: random pixels over stretches of time, rendered again."""
