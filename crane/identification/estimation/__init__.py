"""Linear estimation: regressors, estimators, noise models and covariances."""
