"""The chances with which the slots of `context_model` and `number_model` begin, learned from
simulated worlds; written by scripts/context_chances.py. A byte for each slot: the probability of
a 0 in 1/256; 0: unknown."""

CHANCES = """
c-rk62T)Yk_N*<U<`Wwd<*SL&ps1+d#72lQ#zeuWh#Hg;3!;GZy0k}IcG*VRWm$HYZ7jWaP%t1O#2OVf=9@$_$@pVpie-Lcl=t7euPiWNW|E)
rXTEo4=bU%X?f3M%7b;@+08u#ef5d?<_B9k5-}ntv1)S;kS^CR$6q?%ci<!<zWa(i27=c%PKBc}(B<-B8&O8utjzJO@0zqS<e&sZu0M0Ez6eL
8$*h`YfKXAHWIG3{>11|h+-?)3dzi^-;|8p;wccCC3^VpeUESK|qh0ra-Yg^?26~%Z|ZVAANIJ~Ji6`*!Mo{xD0<Y@2&p$R}0jAuj!1DrSEZD
%zAnJ4f-LnXk4LwLt!KESbcc(sokfWn9elr$6ld~rp15P(dIzwn$GAmJ)L(((v^WEVbpv?oByEPUGVWdL5?xWzD{-g7ZNb=aFk`?Ox`i8=uJx
A>^({{+Yl?44~{NQ`TVkK;@v+I^0XnR*@I;8c9hh`9hC<>IEYB!GZq+}1J{rb+=E!_PeYl|H)6nrjGEtEx)K(|eVmZxo!r^N6PBR(*m{nWp08
DRl0{&%(KuIsC2MOoVzwW%9ow>BEWN2w8P6b2lyp2%V8#f}NwQCV19AV8-Vco<gWxme=?bU1#ZD@qp={pzB1aOrdM~H(fW@$#|ckW9n{%N-~s
%cj>z4*W}!L%+RGDA~Zp&thrCujaeRlhoQ$wTM?R^BFbjQpI3PKHp6MkuCoZO6_uv?GVGSn{RPus(%6Mil}2|ogRYzGUv-<=U$U_cp?X6}X*F
Fp-n-&9b39x{BZ69aQyEidwJrS;+h5s2oqv#0e3YSY)!$&~DH#-95>cAT)J?~<Uo&F~%a0(Ko>X8W;m&*xNPBKETZPhZIuPtKDX)`oSqKM`zd
X)t4^Ff-QBduV;J5<-Hk;3}*XyaJwjxn<BAArLf%Df&+5V>+jw9F{Dn`)GmII<|^$!{P*<+Om7SrFOLy7Zszrt(<_6vVNFq(IQ75AC$$*dwUq
_rZb^3E<`>L%K~!LF|)Jq*F3eQxOZcqst4B<%9wF^w`cOXCTVYci`A)pZKye?`H$u>dP~E7%4Z3hLT2L@Esl*F*t0J8u#)4U9Qr)F4`lWoYsM
wh?sK1#>op(JTB2OOL7|V2j*4tDdKXrP~1hVPiGLAqxg6k?=>02?KZ_8Jg}y&{Hp)_kV=m_mS@?IG<SmHfb^2Kv<nk@ozRykK{a#I3IUU-p`E
uH0WDM*rq<_q96old<Y@`)7JX>F*huYu2GY63MU1=5Cx-DgnYhWweEv<W`-6>V^<Ree|FgyP3-A}dH)qRXg>Owg2BZ8f+FK?GYpoeP@(<h@Z)
vOgjr}x1lSdjtz`PAXfIImL4V(czjkp7TXZfcQ~d?YPbHLG^G#SP2_2)>oZBNUxXjS?N2@6PqYOdx#l*>MNoCa&<P8{qb*#<J4ZDK)r8nvRmB
qQ22v{S^i&oUPKv<Z=iS1kVB^tk{<x6HfPHHfbDod^u>L5`NlfG=N@AV6eeamR0^v?lRISH2oJe+DX-Z6EE{YhZL&wsaf+<{Tu;EKSYJx|K1r
W_g}8hX_4o<Hcd{VdbI6)OL$=lco#f0y-yeh4Tx%b)fPEr0aEj3!*H@h`d6F)g?W=~|>`Vnh<YjG!k2jGD9}p!^<1KM-PSG7>O!k2pO^Qu>!a
pFOasU79j9{e7^#iE+(5c?RoGUr73D@}c|Bh&)_o?-rub)8FN-rN|OViz|_PGn2bJbBSxm=_+~+yu1!%fWr;>v4wC1#wRBS&0O_EMKI%Eby5b
z=lnJ5{=lczYQ}t*8uOI>RyYdQbWO5de<hr9Hy}H;8R^%sfE>b(W`L!Bcb)Z|H@|OYItR9VhV*hoOiM95D^I)lB>RLXx0vO(l6Lxa=P9@`Hdc
|`YWBa%XupE-o!=Ai)RI%?@$v_ZAI?n)iU{YmF*6iu^NNt47MoR6(?E<L7Uy>;IKGi_Ftr7hUC0jPM(Pp?pJIO6p)5yd&!z{A|Dwo24sbLk5(
|jQl-yL_UZ?ebxpc75X5eW_4_IU@5*n~lSiUPabftrbuZlM0RS61Y;T!7qWBDiRz$PoO&~CnmSV`-v)N)nXMN*EMR4&DYmwW#ii#*lxc9K(Zb
fk&>9;h>>6Thq{^j|{!Ha~$LnP}VN7apFWzeIgEWY?6C{E;QjDAHG{VRhoNlTLg6m2D>}x-6#xg@w7X{>ka>d0>6mv1755e~kPN?Z4;^RpffI
w3$3zU=}pTz4()>$Km}kRM-PetsTvzhjqEW8@eF}mcrr|hqXKQ_|nm2u;j``vcGbR0h*x!tn=Ua(%R1DuuMn!WhzXVCnpY}EGA1-VbTHV?yma
-=ev^ducj@3ed;q#`+a3sIB{pk*zgx}duT|1J178r8(_$Y$eYxWPZ<A&RDaowMSCQS{!C5JMsce!8jB4iLb)+XuEq(Aw&XJjf(&&k3co^gC4v
;fQd@*Nn#N9jOLvb}u;O@r1BnU}_~JBuJ3OB#7EfGY@7+l2^<Zw+5z+*B_=gDeSS5@KKcpXHW#?7<5gi}JBp7cIFwG|k6B)%YGGcSS#gy0LuY
XJDhoX3SWat$UB+|#_>R~pSe|g4TPpvHclgED{Xls$x%I;4;W%7U03&@!b5?n+Y&syj!p0&31;~s|prB@LY>8b44?0s%In<9+rIyysSEN?6z9
fSnET2fB9n!|(Fb&mMk^v_zosRTn*h7e8VtMaHl1qK)w>QXylrt3{Q{DYvVLKLi~`UR<v5zxld!?5b0tX<|w2_a8g)m=g8PlHUWsm0QsG01O}
8SoHBOd9d}*H3BwxquIQY2y6V-!c^kJ(u<kzF&h!;I!yH%~1X4lRWwkHsts=@Ob3BnQtZc3?AMP_7Ug2V!cHCFUFrWdM`$PDx@DE=eLE&!|hl
2vH2s2XzADAf>__OO~FIXKLvU@mJ7G<`H`7j6NM7YTsdF`NPcn79Q$>ACjXxi9gP+kfpNW#%gFh0&fM36<ctN<V1dX5$I9I$q_6Zc^bVV{@SS
SLzfRqoLkFANQF?qb(cfz6#-#6<{7;xrhUBa^E!bcHh{2>jJx@rPtof65OiD<aZ&7_NyMkIe&#0xpXSr26Zsr=;_ARph{h#+$!|p!Z(K=v!%M
EAOEn0A(nXTaW57v|8WZs#jrx|k&HH}mz>Nsu47lcbUxJyiIekrr^7G-CF;)8j?#rvHD`K;SoW*Tt+SgXSVCn1}E^VU%LIcGi}Mbwco>E0q^1
IwPKvU&vNiZrw<o2cSdYeF;Y82%_IsY3cuxYG;BqZ%vVy}#0jcZcQfRw}<Q12v_;-K*bxc?Y+KiSUxtdh~#xm70w8{{#AG8liveCQWu4if;D@
#~((>=a`Ah-_;I5-$c-@R;;QUs{c}g{-TY;PR;L}e+=}3<&0VD{R0P6Kp40Z^1EsECO3vFu>pzD-SBwWu9Z&S?L&;elhALA-`F2Gw0_5jO?hR
WbF7%s5NTS>Jq>YN%LPzp!H%bV|MqgZPG~yFe%~BGf6)aXWbf}Ef4G3q5i3@?4;g=ENdwZ)n5~13eqUnp;5$W$GW{tt_vi-NADKLy*C%K_IZ*
!-x4qka==E)m7e(v3>KOM1I!~kY2sF1)4!LV=+QE{ZPWFASyN%)mM$K&HXQXPbvg!psywN`naSc%<$vd-It#q88shs|vC?Iug1N-<d$U1|bio
~MwB68Hp6~rDtDEyImUy)=VN16U~k*bXRcK`<`-=H~eJ#30;LMin^Xm{0^b^}Ht`iO-QEIoxr-Tkm|%Bpe9=_%+P<cv6v?y~!T^f86jvl%6VU
j38Vo?NBvgrHCV*t={17vD{xN!8|<uJ8Q#VDtB>eDoXiD}&K{pS-_GbKc{Y-lsHtnoOwfAketv6oVv_dW*Jwn_GU9o;Wur=O~G4ggN;&Vye=?
FZTkY-zyAlh#S)d#ezn<ZlCz*H8%fONHKs>-^tqCTW8H@nK_6ru*B;k+rV2%c`~YObLQ-m;?G!I{W%4X^o=3bxBbfYH&PAcqK;}X^A9S|Sy&}
7W|_XNe)N%}XEJO}x6|~a&pwO~2*VGe_e;)*krtDt&-I|s-pL~%mPQpYC7%3`#3+mBrdT;My_M}=G|C_JzWV83qGjY0_=ocw{mttiIo@`XJ;k
*f!xL$5Zcu*gTmA#XM*E-
"""
OF_COARSE = """
c-rk+2~ZSA6#c`YcpJrtCZ%FLBc&u_)JjsOG-^bR;(?`6&}fMYK>_39E;1_TuE?=2vaGPIEVsBI?g}D;h$lu7D=0CERTzjG@2k9b(mOrV18YI
7G9EGes;2($e$#(vx_|fl-@OOQ4T*qY7yaZZa9C1{)q+A&1-60Di0)R0W#KMT1ysjN46i#%u<Et-0<OrEoT1L1+YMpVaR{OVz_+jH8C6ybHka
2Yz&a6htD~8l)M;pyO)VS>VsISNyYAL~3gmS8<k5>DRU?mDttcrkPNL;dp<(n%N`QTNOss4NK$(;=s3QPMBurLN48Sf8lN^$Q9$w01tVgd_t!
4IUG5|^o7-=ZF|7eV{A|3I2Rx*ZoIg-gtxH<u#c(pMzW;H-UDAS?!3V<zIrnBuDfbFivPVMFZq`EL2t)~KnNSHR(YXR0TV%kzm0Jd#0+ILq0$
V!cN-O=w9j(_@D&rJXZCu7If&H!|du}AwjfM91M*nNwhBaKN{?gZEz$b9J#3NBFqqMBQzb9eoQJNJ+}o0Y>W0hXP({g~%7&R=5X5tV|K_U{3V
+E{Ajd2u0DmCMet^8I$Gy?iUNU#h@rKyoG-yN`2k5I(UCt0}6}gde22O6(_>VKpbSmhc0%T_e2eAXay5yFmE9vGs(P>#?d({37sSmkBT9o?jF
7JK-muY9RVP9hT}e!S}`<tAE1l`K8x!KV{Q|AC-TN=-FjhrW_L5J7)^Ks*;mpfghGwNAzubuuR=4@B>1sh4;(AYP?)S_z?+b$VAH9ht+UtGAn
22QxI7%%&nrU+}z5;a*Q_xdAEdlSbK*XN3J~Dj{@aA;vR4ey9bnT<@v={kb94G4^-X2vYab>2H3(Ofd*kzF=n{ig5rTtJ`B&pao!)~{gp{rl_
fkPe9wV3gwI)sReBkgXJh~jG>;@S1@APv!TjDOp~z?N3jLGCseFy!di0L+deT9(4y!2&EH?$CJ|5?Li|1qMIDDTkEi%a;(bCf6!wGBQ72&2If
UyO>VkN-C7Wh@j%}ehJ<t#IPVi>^6Rf7M<MPM1I#B#7Nz|0we&DytG1<-!vC=t9N=r^G8Z`48NeU%l2=F&OAD^yij9>>!Qj-vjV<12iql+{><
!@GgVkhTpu{=x)K;?|GzTsdfKtGmetVSUNq)Qfz3A9%FqoM2C3W`CuB`v+4NNovS=6yX&hgR}6%#;$+P3CgVDpFo?cWL2edhpTBNjt(7K=T@X
HAnW64yq2ePW%Q+OuyOQi_Wfv}9@>v}->v7$m3lmu@o<EDkNzMY2Nqahfd%gz3}PXcc^44~l(FuLP`+fw7lgPTxprMBpEu)UqCB>rSNtW!H*x
P)|D?-0LPH}5__uvQ9=t#vS$v<Aa}GAmZ`^{0>zD5p@{8zWT%5rL3eGV=&oT)1lxFsGBm6hbmS|4!BNQKNV2uTDN~_W$=_H+&J<d->;_t8&92
qFHl33X<HoRiMw57*LydT5oRV9|i;Vr<b{FX<;{Uz;-eeCPzN>dK-exILL!m9e{`0q@)>V$Ozf1MW{v7hAEWjJxp<|525bWR67Hp))%yiVnV^
StBu(F$kxXc#?J9IWHE7*aF#W|(BL>@bQktKk#n&`0AYukk&}$Ip2u*`0?9E`uJVbhzF7E05qJE}@Ru9m~!j)uN<y8h*Aohy@l{V1WhyNtiZn
s$QY}l&zC=XAf1Aa-tc(6kT2~VLw1Jf5#DhS|$1Zt8s*?Ex-Zn2=JiCO1*{r!L0qK=o-?3eS37-^q+2Vl(!TgfzhVVqyXZ=v_IX1{{~$SuW<j
cCoon6NBR-}^Ij9g%FSX8Tjv6gZ3a*A%xbRvFm&0{&D-w^k8QiTG|IZXoAQH!q54h|)!gLDYa>HE*|=TyeZFb4w;vd(fy={4S{*1G&&tJsH(0
yCQ|sPtbNS;U$TBgF&=2t)#>{M#0g9fB|3|;U@ec=$OR!q#A6<4+-Vq`}q-?&u1G<K`VBf~H225z4Ph6HfV?%Ty89^;~ei_I0sIz<K{26=plK
WL=?Yp29W1@Sb4U)X3yfwOdO>I5{+qh2Yx+XbS$7k@nbq3ag#50O5I|03T+LnBBz^dksiui<kz#OfY)7Pnj!Tr1+U|2!kuwI|LpA>E=w=6mqS
YW|xLH%ope_MiVt=#|ON%DCIy{;+WHw<8+`U*LKl^@2Z`P;R)jr~t(4feV~4zPpL@Lp`>7R*zKp{QP!<c7{teAIe-y4Lg$npP&h%?F-5pXBO;
x5_lLVtu$es)hegya@lYc+<cCe+Kp+3@h8NVO;e(E;?w!+u3#D>R~e$nkIaI2^pPGELObo=U;$+Qrd!lP%rrYR<@n`baQeuHTM;T<#K;`q5sj
}I#|El^ZyO8!mb4
"""
OF_ATTRIBUTES = """
c-ouJ$iTqJ$oQWD4*sLiNfitXo1V45g~=X2q6((>FfbfIR*ee~lGmtXU~r7goV;@T4KRP&w598}A7x-@Y3o_g-PggO1C$S+c;NDRsQOu(cV7b
0i>I#ZJ_)4P)H5*D%)j&nX5O5GH^KD$RR^wv=o!@v3_Fj0gWGoiBF(S~%I^jGZ^P!NaQU74AoM{fza41)^dpbq@+-GN=>B*J{j8FK;WZxr&1+
|1xc?8q|AZ#LxQc<{=5GZ55}N#iCSaJqLl|)D9)x}Y<pTir{!Mr
"""
