"""Responses that several routes give: jobs, files of results."""
