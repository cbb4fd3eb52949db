"""Who can say how many photo-electrons per second each pixel gets."""
