"""What every node shares: topics, options, exit codes, the DDS profile."""
