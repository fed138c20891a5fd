"""The way in and the way out of files: bounded sizes, checked forms, atomic writes, hashes."""
