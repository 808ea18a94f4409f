"""Methods of attack beside each other, each with the setting that suits it best."""
