"""Sources of flux: the mean number of photo-electrons per second of each pixel, from renders or videos."""
