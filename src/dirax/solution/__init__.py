"""Solution: what a run gives back, and what is done with it.

trajectory.py         the numbers; solution.py the same with everything below as methods
moments.py            the fields at any time, between rows as well (dense.py, dense_traced.py)
selection.py          parts of it; export.py tables for other programs; plotting.py pictures, in the one style of style.py
saving.py, loading.py files: description.py says which attributes they have, plain_forms.py how schemes and parameters are written
zarr_store.py, netcdf.py, stored.py, file_record.py, atomic_files.py    the formats, and what is checked before it is believed
reconstruction.py     from the quotient back to the configuration space
"""
