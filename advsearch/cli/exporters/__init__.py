"""The built-in exporters, as `advsearch.catalog` lists them."""
