"""``python -m hesim_render.cli``."""

from hesim_render.cli import main

main()
