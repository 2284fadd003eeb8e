"""Many runs side by side: the state of a lane each, and how all of them are moved on together.

- `lanes`: the state of the runs that are advanced together, and `Observer`, the base of what can be
  asked of them;
- `step`: one Runge-Kutta step of all lanes; `events`: what follows where a step lands on a guard;
- `rounds`: how a run begins; and rounds, events and some steps, that are written down.
"""
