"""SFT and GRPO of a touch policy, from parameters to parameters, in plain library calls.

    policy = build_policy(ModelConfig(), sensors)                                     models.touch_policy
    params = policy.init(seed, touch)                                                 touch: a TouchBatch
    evidence = sensor_evidence(features, present, label, objects, policy.levels, ProbeConfig())    linear_probe
    batches = AnswerFeed(policy, clips, evidence, batch_size=16, questions=2, seed=0)              feeds
    params = train_sft(policy, params, batches, SFTConfig(), hooks, seed=0)                        train_sft

    features = encode_contacts(policy.fns, params, touch_batches)                                  encoding
    noise = noise_bank(policy.fns, params, touch, seed=0)                                          encoding
    questions = QuestionFeed(policy, features, label, batch_size=config.drawn, seed=0)         questions
    score = make_score(policy.parser, make_rewards(prior), weights)                                rl.scoring, rewards
    config, loop = GRPOConfig(), LoopConfig(steps=900)                                             rl.config, loop
    params = train_grpo(policy, params, questions, score, config, loop, hooks, noise=noise, seed=0)   train_grpo

    evaluation = evaluate_policy(policy, params, test_features, test_label)                              evaluation

`clips` is a Grain dataset, or any iterable whose iterator has `get_state` and `set_state`, of mappings with the arrays
of `TouchBatch` and the number `contact` of each row; `touch_batches` are any `TouchBatch`es.
`hooks` (`loop.Hooks`) holds every side effect: log, checkpoints, a stop signal, devices; without it there is none.
"""
