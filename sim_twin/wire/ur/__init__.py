"""The served UR controller: RTDE, dashboard, URScript and the streams."""
