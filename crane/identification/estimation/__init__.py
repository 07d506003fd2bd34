"""Linear least squares: rows, estimators, noise, and how sure they are."""
