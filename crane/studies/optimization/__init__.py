"""Design optimization: parameters of a machine that are best for measures of it."""
