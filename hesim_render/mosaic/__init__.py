"""Where each pixel sits, when it looks, and what a picture must know of its colours."""
