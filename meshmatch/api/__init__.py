"""The composer: each verb of the command line is one typed call here, and `import meshmatch` offers them all."""
