"""Models of whole scans, and ray casting."""
