"""What clients send: bodies, archives and uploads, unpacked in a sandbox and made into datasets."""
