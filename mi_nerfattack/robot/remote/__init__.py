"""A policy on another computer: frames there, decisions back, by zenoh."""
