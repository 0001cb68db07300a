"""Recording contacts by protocol: prompts from the live force, a journal that survives a kill, records at the end."""
