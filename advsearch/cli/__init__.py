"""The command line: parse, call the API, print. One small file for each command;
nothing imports this package.
"""
