"""Shows a running session on a terminal: a screen that is drawn anew, or plain lines."""
