"""The viewer: runs as pages that a browser lets one explore, from a single file or from
`advsearch dashboard`.
"""
