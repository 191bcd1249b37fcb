"""Traces of a fleet, decoded on a Spark cluster by the package `cantap`.

`inputs` finds the traces and each vehicle's databases, `worker` decodes them where Spark says, `dataset` writes what comes back and
proves that all of it is there, `questions` asks.
"""
