"""Many runs side by side: the state of each lane, and how all lanes are advanced together.

- `lanes`: the state of the runs that are advanced together, and `Observer`, the base class of what
  is recorded of them;
- `step`: one Runge-Kutta step of all lanes; `events`: what follows where a step lands on a guard;
- `rounds`: how a run begins; and recorded rounds, each the events and a few steps.
"""
