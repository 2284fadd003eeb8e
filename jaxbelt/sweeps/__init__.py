"""Sweeps: many runs in the lanes of `kernel`; `sweep` and `basins`.

- `observers`, `attractor`: what a sweep can observe: final states, a user's reducer, attractors;
- `moments`, `along`: reducers that are asked between events, too;
- `queue`: the compiled loop that fills lanes from a queue of runs; `threads`: a loop on each core;
- `grid`, `question`: the points of a sweep, and what makes two sweeps the same;
- `datasets`, `store`: the results, in memory and in a Zarr group; `locks`: who may write it;
- `work`: the runs of blocks, here; `clusters`: blocks as tasks of a Dask cluster; `progress`: a
  bar;
- `sweep`: named axes in, a labelled dataset out; `audit`: runs again, without shortcuts;
- `shares`: the attractors that several starts lead to, and how many lead to each;
- `basins`: the same for starts of one oscillator; `fractions`: for starts at many values of one
  parameter, the attractors matched from value to value;
- `orbit_diagram`: the points of attractors against one parameter;
- `circle_map`: from the phase of one slip onset to that of the next.

A new observable is a subclass of `kernel.lanes.Observer` in a file of its own; `sweep` takes it as
it is.
"""
