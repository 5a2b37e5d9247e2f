"""The HTTP service and the web page. Never loads torch or pycolmap."""
