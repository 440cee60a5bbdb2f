"""What stands between the cameras and the policy under one method."""
