"""Experiments: what delay, loss, churn and topology do to the estimates (docs/experiments.md).

spec       the experiment file
axes       what varies, and the points that come of it
plan       every point a checked scenario; every run a task with a hash of what defines it
execute    one task: a simulated or live run, its observed messages, its metrics
observed   the messages of a run as arrays
metrics    the metrics of a run; `catalogue` says what each is
engines    where tasks are executed: here, in processes, on a Dask cluster
store      the directory: a file for every task that is done
table      the tables
run        from the plan to the tables, resumable
"""
