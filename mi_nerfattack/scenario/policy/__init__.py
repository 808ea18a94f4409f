"""The section `[policy]`: kinds of policies, and what is common to them."""
