"""Found attacks finished where they are to work, by few drives there."""
