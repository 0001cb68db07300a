"""What a run leaves for people: results, findings, charts, pages."""
