"""What routes answer with: jobs, files of results, signed links."""
