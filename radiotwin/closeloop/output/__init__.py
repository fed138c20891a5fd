"""What a loop leaves: closeloop.json, corrected scene, twin and residuals."""
