"""What runs beside requests and jobs: dispatcher, expiry, backup, supervision."""
