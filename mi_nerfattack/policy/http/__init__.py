"""Policies behind a URL: client, policy and server."""
