"""Functions of arrays by sites: entries that are the same expression at other places are one expression of a scalar graph.

pieces.py   an array as pieces: progressions of entries, each with one expression; how pieces meet, are moved and found
walk.py     a jaxpr run on pieces; its results are `Sites`, from which loops are compiled
"""
