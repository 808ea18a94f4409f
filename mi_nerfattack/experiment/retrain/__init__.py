"""Better policies by the attacks that were found on them."""
