"""The base of all other packages: errors, units, random numbers, the Dr.Jit backend, output folders."""
