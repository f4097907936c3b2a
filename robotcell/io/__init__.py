"""Files that are whole or not there, and records in shared memory."""
