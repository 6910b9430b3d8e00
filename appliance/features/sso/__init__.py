"""Single sign-on beside tokens: people sign in at the site's OpenID Connect provider."""
