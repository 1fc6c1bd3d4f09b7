"""Jobs: the missions of one method, run alone or many at a time, and what they leave behind."""
