"""What a recording tells of motion and force: filters, derivatives, outliers, hum."""
