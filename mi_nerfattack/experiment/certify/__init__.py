"""Certificates: bounds on departures under changed textures, truth of gradients."""
