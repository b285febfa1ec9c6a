"""What runs show, as evidence for a model card or a safety case; `advsearch report`
writes it.
"""
