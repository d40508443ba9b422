"""Everyday nouns. The mean of their vectors is the mean of a text tower, which centered cosines subtract; and they are
the words that features of a tower can be asked for where the tower is missing. Listed by hand."""

_LIST = """
air conditioner, airplane, alarm clock, animal, apple, armchair, backpack, bag, ball, balloon, banana, basin,
basket, bathtub, battery, bean bag, bear, bed, bedside table, bell, belt, bench, bicycle, bin, bird, blanket,
blender, blinds, board, boat, book, bookshelf, boot, bottle, bowl, box, bread, brick, bridge, broom, brush, bucket,
building, bulletin board, bus, bush, cabinet, cable, cake, calculator, calendar, camera, can, candle, cap, car,
card, cardboard box, carpet, cat, ceiling, ceiling fan, ceiling lamp, cereal box, chair, chandelier, chest of
drawers, chopping board, clock, cloth, clothes, coat, coat rack, coffee machine, coffee table, column, computer,
computer mouse, container, cooker, cookie, counter, cow, cracker, cradle, crib, cucumber, cup, cupboard, curtain,
cushion, cutting board, desk, desk lamp, dish, dishwasher, display, dog, doll, door, door frame, doorknob, doormat,
drawer, dress, dresser, drill, dryer, duck, dumbbell, egg, elevator, envelope, eraser, extinguisher, fan, faucet,
fence, field, file cabinet, fireplace, fish, flag, flashlight, floor, floor lamp, flower, flower pot, folder, food,
football, footstool, fork, fountain, frame, fridge, fruit, frying pan, garage, garden, gate, glass, glasses, glove,
grapes, grass, grill, ground, guitar, hair dryer, hairbrush, hammer, handbag, handle, handrail, hanger, hat,
headphones, heater, helmet, hill, hook, horse, hose, house, iron, jacket, jar, jeans, jug, juice, kettle, key,
keyboard, kitchen island, knife, ladder, lake, lamp, lamp shade, laptop, laundry basket, leaf, lego brick, lemon,
letter, light, light bulb, light switch, lock, lunch box, machine, magazine, magnet, mailbox, map, marker, mat,
mattress, meat, medal, microphone, microwave, milk, mirror, monitor, mop, motorcycle, mountain, mouse pad, mug,
nail, napkin, newspaper, nightstand, notebook, nut, office chair, onion, orange, ottoman, oven, package, paddle,
padlock, painting, pan, paper, paper towel, parasol, park, path, peach, pear, pen, pencil, pencil case, pepper,
person, phone, piano, picture, pillow, pipe, pitcher, pizza, plant, plastic bag, plate, pliers, plug, plum, pole,
poster, pot, potato, power drill, power strip, printer, projector, pump, purse, puzzle, quilt, rack, radiator,
radio, railing, refrigerator, remote control, rice cooker, river, road, robot, rock, roof, rope, rug, ruler, salt
shaker, sand, sandwich, scale, scarf, scissors, screen, screw, screwdriver, sculpture, sea, seat, sheet, shelf,
ship, shirt, shoe, shoe rack, shopping bag, shower, shower curtain, sidewalk, sign, sink, skateboard, skirt, sky,
slipper, snow, soap, soap dispenser, soccer ball, sock, socket, sofa, soup can, spatula, speaker, sponge, spoon,
spray bottle, stairs, stapler, statue, stick, stone, stool, stove, strawberry, street light, string, suitcase, sun,
sunglasses, sweater, swimming pool, switch, table, table lamp, tablecloth, tape, teapot, teddy bear, telephone,
television, tennis ball, tennis racket, tent, tie, tile, tire, tissue box, toaster, toilet, toilet brush, toilet
paper, tomato, tool, toolbox, toothbrush, toothpaste, towel, towel rack, toy, toy car, train, trash can, tray, tree,
trophy, trousers, truck, tube, umbrella, vacuum cleaner, van, vase, vegetable, vent, wall, wallet, wardrobe, washing
machine, watch, water, water bottle, watermelon, wheel, wheelchair, whiteboard, window, window sill, wine bottle,
wine glass, wood, wrench, wristwatch, yoga mat
"""

REFERENCE_NOUNS = tuple(" ".join(noun.split()) for noun in _LIST.split(","))
