"""A log replayed: what would a correction have known of each command before it acted?"""
