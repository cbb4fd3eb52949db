"""Change-driven rendering, the default source: only changes are rendered, with as many rays as the noise requires."""
