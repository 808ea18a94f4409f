"""Figures of vehicles, experts, collecting and DAgger."""
