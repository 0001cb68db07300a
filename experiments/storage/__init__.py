"""What `pareto_storage` is made of: codecs, the clips that they store, the feed that reads them, charts."""
