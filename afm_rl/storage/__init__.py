"""Storage: what is written to disk, whole and with its checksum."""
