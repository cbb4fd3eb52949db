"""The default source: what changes is rendered, with as many rays as its noise asks for."""
