"""Signal processing of recordings: filters, derivatives, outliers, spectral lines."""
