"""Image-based driving policies: network, adapter, training. Imports torch."""
