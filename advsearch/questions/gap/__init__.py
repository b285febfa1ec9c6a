"""`gap`: the worst case beside the average."""
