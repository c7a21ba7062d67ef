"""``usdbrdf convert`` as a child process; nothing here knows Blender."""

import json
import os
import subprocess
import sys
import threading

RUNNING, DONE, FAILED, CANCELLED = "running", "done", "failed", "cancelled"
# Blender's own, which would lead another Python astray.
_NOT_INHERITED = ("PYTHONHOME", "PYTHONPATH")


class ConvertJob:
    """One conversion. ``poll`` brings it up to date; it never waits.

    state  RUNNING, DONE, FAILED or CANCELLED
    line   what it said last: progress, or the one sentence that says what was wrong
    asset  the asset's root layer, once DONE
    """

    def __init__(self, executable, scan, output, options=()):
        self.state, self.line, self.asset = RUNNING, "starting", ""
        self._cancelled = False
        environment = {k: v for k, v in os.environ.items() if k not in _NOT_INHERITED}
        try:
            self._process = subprocess.Popen(
                [executable, "convert", scan, "-o", output, "--json", *options],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
            )
        except OSError as error:
            self.state = FAILED
            self.line = (
                f"{executable}: cannot be started ({error.strerror}). Name the program usdbrdf in "
                "the add-on's preferences."
            )
            return
        # Both pipes are emptied as they fill, or the child would wait for us.
        self._output = []
        self._readers = [
            threading.Thread(target=self._keep_output, daemon=True),
            threading.Thread(target=self._keep_last_line, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def poll(self):
        """The state now."""
        if self.state == RUNNING and self._process.poll() is not None:
            for reader in self._readers:
                reader.join()
            self._end(self._process.returncode)
        return self.state

    def cancel(self):
        """SIGTERM: usdbrdf keeps what is finished, and the same command goes on from there."""
        if self.state == RUNNING:
            self._cancelled = True
            self._process.terminate()

    def _end(self, status):
        if status == 0:
            self.state = DONE
            self.asset = json.loads("".join(self._output))["asset"]
        elif self._cancelled:
            self.state = CANCELLED
        else:
            self.state = FAILED

    def _keep_output(self):
        self._output.extend(self._process.stdout)

    def _keep_last_line(self):
        for line in self._process.stderr:
            # The panel has room for one; a report of a defect needs them all.
            sys.stderr.write(line)
            if line.strip():
                self.line = line.strip().removeprefix("usdbrdf: ")
