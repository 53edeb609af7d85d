"""The web viewer: one view of a run, whether it happens now or was recorded, and a page to take home.

Read in this order: ``story`` (what is to be seen at a time; plain values), ``surroundings`` (where it
happens), ``scene`` (draws it in 3-D), ``panel`` (controls, pictures, plots), ``player`` (lets time pass),
``server`` (who may connect), ``live`` (runs started from the browser), ``page`` (the standalone file).
"""
