"""``calibration.yaml`` and its maps: `calibrate` writes them, sensors read them."""
