"""What goes wrong between an environment and a policy, and where things stand."""
