"""The page on which a person answers, and what it needs: sessions, their store, videos, beliefs."""
