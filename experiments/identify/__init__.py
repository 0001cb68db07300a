"""Of `identifiability`: touches drawn, probes, studies, tables."""
