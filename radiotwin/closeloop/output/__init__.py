"""Output of a loop: closeloop.json, corrected scene, corrected twin and residuals."""
