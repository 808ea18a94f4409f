"""Studies of attacks over drawn places: a row a cell, appended as it ends."""
