"""What everything else stands on: errors, units, random numbers, the Dr.Jit backend, output folders."""
