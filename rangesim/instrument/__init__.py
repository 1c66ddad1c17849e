# SPDX-License-Identifier: Apache-2.0
"""Instruments: a sensor with its camera, emitter, detector and decoder, and the light-transport pass that serves it.

A preset of a real device is an `Instrument` with the numbers of its data sheet; its module would be in this package. A
new measuring principle is a `Sensor`; its module is in `rangesim.sensors`.
"""
