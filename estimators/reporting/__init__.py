"""Tables, HTML pages and JSON of results."""
