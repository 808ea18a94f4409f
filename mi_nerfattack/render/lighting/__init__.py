"""Light between fields and surfaces, and spectra."""
