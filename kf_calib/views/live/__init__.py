"""A live run as people see it: what a screen shows, on a terminal or as a page in a browser, and a line of text or a
JSON object for every dwell or pose."""
