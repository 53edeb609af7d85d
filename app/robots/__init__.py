"""Users' arms: robot files drafted from models, and examined."""
