"""What every room uses: errors, samples, units and magnitudes, files written whole."""
