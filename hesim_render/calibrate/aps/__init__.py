"""From dark and lit frames to maps, variance polynomials and photon transfer."""
