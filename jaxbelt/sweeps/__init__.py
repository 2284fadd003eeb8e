"""Sweeps: many runs in the lanes of `kernel`; `sweep` and `basins`.

- `observers`, `attractor`: what a sweep can observe: final states, a user's reducer, attractors;
- `moments`, `along`: reducers that are also updated between events, and their integrals;
- `queue`: the compiled loop that fills lanes from a queue of runs; `threads`: a loop on each core;
- `grid`, `question`: the points of a sweep; its checked arguments and its identity;
- `datasets`, `store`: the results, in memory and in a Zarr group; `locks`: who may write it;
  `verification`: whether it is what was written;
- `work`: does the blocks in this process; `clusters`: does them as tasks of a Dask cluster;
  `progress`: a bar;
- `sweep`: named axes in, a labelled dataset out; `audit`: repeats runs without shortcuts;
- `shares`: the attractors that several starts lead to, and how many lead to each;
- `basins`: the attractor of each start of one oscillator; `fractions`: how much of a box of starts
  each attractor attracts at many values of one parameter, attractors matched between values;
- `orbit_diagram`: the points of attractors against one parameter;
- `circle_map`: the map from the phase of one slip onset to that of the next.

A new observable is a subclass of `kernel.lanes.Observer` in a file of its own; pass an
instance to `sweep` as `observe`.
"""
