"""The audit: a random sample of pixels and windows is rendered again, and bounds the error of a run."""
