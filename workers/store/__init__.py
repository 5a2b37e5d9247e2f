"""Files by key in a folder or bucket, and their deletion."""
