"""Whether what meshmatch writes is opened by others, as it was written."""
