"""What a scene needs: the plan, with the reason for every decision, looked at before anything is computed."""
