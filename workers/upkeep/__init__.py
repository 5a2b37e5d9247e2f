"""Work besides requests and jobs: dispatcher, expiry, backup, supervision."""
