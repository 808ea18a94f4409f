"""One page of what run folders, sweeps, transfers and retrainings came to."""
