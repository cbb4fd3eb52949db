"""Geometric truth of a scene as a sensor sees it: surfaces, flow, poses, boxes, inertial measurements."""
