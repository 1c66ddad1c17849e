# SPDX-License-Identifier: Apache-2.0
"""Writes and reads every result on the disk. Each kind of record has one class, one writer and one loader, in one file.

| kind | class | writer | loader |
| --- | --- | --- | --- |
| a run | `experiment_results.Result` | `write_result` | `load_result` |
| a scan | `scan_results.ScanResult` | `write_scan` | `load_scan` |
| a decoded capture | `decoded_captures.Decoded` | `save_decoded` | `load_decoded` |
| a capture | `rangesim.capture.Capture` | `save_capture` | `load_capture`, `import_capture` |
| a pattern set | `pattern_sets.PatternSet` | `save_patterns` | `load_patterns` |
| a range image | `rangesim.decoding.range_image.RangeImage` | `save_range_image` | `load_range_image` |
| signals | `rangesim.signals.StillSignals` | `save_signals` | `load_signals` |
"""
