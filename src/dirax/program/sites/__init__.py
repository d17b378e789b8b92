"""Functions of arrays by sites: entries that are the same expression at other places are one expression of a scalar graph.

courses.py  which entries of an array: progressions and lists of numbers
pieces.py   an array as pieces: entries with one expression; how pieces meet, are moved and found
walk.py     a jaxpr run on pieces; its results are `Sites`, from which loops are compiled
"""
