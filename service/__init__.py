"""HTTP in and out, and the web page. Never loads torch or pycolmap."""
